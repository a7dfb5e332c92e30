"""Background jobs: the same functions in-process by default, or by Celery workers over a broker."""
