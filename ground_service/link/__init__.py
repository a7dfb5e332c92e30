"""From a stream of downlinked octets to batches of checked packets and decoded columns."""
