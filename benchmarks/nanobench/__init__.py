"""The comparison with real flights of NanoBench; `benchmarks/real_flights.py` runs it."""
