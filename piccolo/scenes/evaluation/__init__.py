"""How good results are: errors of queries, statistics, tables, plots, and runs over whole datasets."""
