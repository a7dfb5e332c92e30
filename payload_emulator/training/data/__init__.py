"""Data sets: frames, labels, augmentation, integrity."""
