"""Automation: rules of mission descriptions that act on events, with a record of each action and its cause."""
