"""Help that all packages use: arrays and texts checked, files read and written, reports, pages, plug-ins."""
