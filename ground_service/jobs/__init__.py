"""Jobs as records: entry, state and result. `worker` runs them."""
