"""One script for each schema of the database since 4."""
