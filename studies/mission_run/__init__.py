"""A mission over simulated days: payload, stations, ground service and automation together."""
