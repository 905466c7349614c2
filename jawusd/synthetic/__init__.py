"""The synthetic person: a jaw that moves like a human one, its anatomy, and captures of it with known truth."""
