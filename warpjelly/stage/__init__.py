"""The animated USD stage: what it contains, how its frames are written and packed, and whether it is sound."""
