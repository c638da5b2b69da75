"""Names of images in formats that place images, not cameras.

Owns      a camera's image name from the pattern, and which names cannot be one.
"""

from __future__ import annotations

from aruco.errors import InputError
from rigcal.formats.rig import filled


def image_name(pattern: str, camera: str, who: str) -> str:
    """The name of a camera's image, a path relative to the folder of images.

    Raises:
        InputError: The name leaves that folder, or text files cannot hold it; ``who`` is the format.
    """
    if any(sign in camera for sign in "/\\") or not is_path_inside(camera):
        raise InputError(
            f"camera {camera!r}: {who} names images after cameras, and no image can be; rename the camera."
        )
    name = filled(pattern, camera)
    if not is_path_inside(name):
        raise InputError(
            f"--image-name {pattern!r}: is no path inside the folder of images; give one like {{camera}}.png."
        )
    return name


def is_path_inside(name: str) -> bool:
    """Whether a name is a relative path that stays where it starts, of printable signs."""
    parts = name.split("/")
    return name.isprintable() and "\\" not in name and not any(part in ("", ".", "..") for part in parts)
