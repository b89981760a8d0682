"""Readers of model files, one per format; ``meshes.py`` chooses among them."""
