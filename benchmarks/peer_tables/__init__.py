"""The comparisons of `bench_peers.py`: one module a table, all on the same data in one run."""
