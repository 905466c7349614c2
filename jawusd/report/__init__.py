"""Draw what the stages found."""
