"""What goes out: the folder of FORMAT "Out"."""

from .folder import FolderWriter, Run

__all__ = ["FolderWriter", "Run"]
