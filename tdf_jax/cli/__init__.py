"""The command line, `tdf`: one file per command."""
