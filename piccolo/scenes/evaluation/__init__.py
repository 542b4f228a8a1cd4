"""How good results are: rows of errors, statistics, tables, pictures, and runs over whole datasets."""
