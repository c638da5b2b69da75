#!/usr/bin/env python
"""Level the world on the real floor."""

from __future__ import annotations

import click


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="rigcal")
def main() -> None:
    """Level a calibration on the real floor, seen by the rig's own depth (not in this version yet)."""
    raise click.ClickException(
        "this version cannot level on the floor yet; calibrate-extrinsics --auto-align turns the world upright."
    )


if __name__ == "__main__":
    main()
