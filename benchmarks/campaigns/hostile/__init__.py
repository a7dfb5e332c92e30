"""Hostile payload build, and the process profiles of the service for tests with it."""
