"""Pure evaluation: arrays in, arrays and report values out. Opens nothing and reads no clock."""
