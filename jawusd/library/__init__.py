"""Many persons' jaws: an index of a folder of rigs, and a jaw for somebody who was never captured."""
