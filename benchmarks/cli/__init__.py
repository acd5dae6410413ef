"""The command line: `main` has the commands, the other files those with many options."""
