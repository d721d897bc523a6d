"""Measures and learns the benchmark tasks: `python -m barchan.bench tasks` and `python -m barchan.bench learn`; `--help` says more."""
