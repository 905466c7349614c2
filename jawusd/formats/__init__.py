"""File formats of jawusd: for each format a dataclass, a reader and a writer."""
