"""Text logs: CARMEN and Wean Hall."""
