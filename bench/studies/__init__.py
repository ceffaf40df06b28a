"""Each study prints the tables of a page in docs/, and ends with status 1 if a bar is missed."""
