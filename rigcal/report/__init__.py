"""What people look at: the terminal for now."""
