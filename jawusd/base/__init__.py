"""The foundation of all layers: exceptions, version, readers of npz and tables, input checks, the schema's path."""
