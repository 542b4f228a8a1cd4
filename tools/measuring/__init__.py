"""What tools/benchmark.py measures, a subcommand a module, and the made-up places that it needs."""
