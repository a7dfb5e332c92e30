"""The ground service: ingest, archive, evaluation, reports, API and jobs of the LINNA payload."""
