"""Quality of results: errors of queries, statistics, tables, plots, and runs over whole datasets."""
