"""The LINNA payload in its world: `sim` is the truth, `flight` is what would fly, `training` makes its detector."""
