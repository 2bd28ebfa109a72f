"""Other libraries' interfaces to a task; one file each, imported by name so that none of them need be installed."""
