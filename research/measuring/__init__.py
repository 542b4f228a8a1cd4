"""The measurements of tools/benchmark.py, a subcommand a module, and the made-up places that it needs."""
