"""Joint adjustment: all cameras, frames and corners at once, with honest uncertainty."""
