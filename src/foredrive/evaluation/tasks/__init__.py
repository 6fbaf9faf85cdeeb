"""The tasks beside planning: results files and truth read, scored under every protocol."""
