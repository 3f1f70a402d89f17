"""Reports: run folders in, one page out."""
