"""The simulated world: orbit, terrain regions, light, camera frames, external images, recipes of data sets."""
