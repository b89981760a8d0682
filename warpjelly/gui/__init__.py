"""The interactive simulation: a set-up that is changed while it moves, and what shows it."""
