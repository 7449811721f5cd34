"""Programs about the program: the paper again, what it compares with, validation and benchmarks."""
