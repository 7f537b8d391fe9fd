"""Hydra's configuration files: a folder is a choice to make, a file in it an option."""
