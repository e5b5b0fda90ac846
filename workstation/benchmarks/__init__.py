"""The benchmarks of ``impasto bench``: a module for each, with a function that returns records."""
