"""Mission descriptions: properties of a spacecraft known to the ground, as immutable revisions of one document."""
