"""Offline work on the crater network: data sets, training, evaluation, export. Never imported by flight."""
