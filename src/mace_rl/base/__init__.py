"""What everything stands on: errors, files, standard output, random streams, saved state."""
