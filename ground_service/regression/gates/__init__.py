"""Gates of a regression: samples of frames, metrics, statistics, policy and verdict."""
