"""The files of jawusd: one dataclass with reader and writer per file; numpy, pydantic and the standard library."""
