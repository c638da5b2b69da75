"""The benchmarks: every module here is one, with a function ``run(*, quick: bool) -> list[Metric]``."""
