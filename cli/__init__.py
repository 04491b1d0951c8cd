"""The `rsundistort` command."""
