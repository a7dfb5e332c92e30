"""The simulated truth: terrain, light, camera sensor, exact labels. Nothing under ``flight`` may see it."""
