"""Campaigns: long trials that are run by hand."""
