"""Mission descriptions: what the ground knows about a spacecraft, as immutable revisions of one document."""
