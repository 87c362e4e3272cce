"""What all rooms use and no reader of theirs needs to open: arrays and texts checked, files read and written, pages."""
