"""Motion of a person from the pictures and events of one camera."""
