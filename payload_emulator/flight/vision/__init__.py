"""On-board image processing and crater detection."""
