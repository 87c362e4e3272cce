"""What measures the tables of the pages; `python docs/make_tables.py` runs it and writes them."""
