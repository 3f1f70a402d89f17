"""The part that all commands share: from the command line to checked settings, and to an exit code."""
