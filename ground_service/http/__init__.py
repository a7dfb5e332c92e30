"""Common parts of all endpoints: limits, origins, uploads, problem details, schemas, time formats."""
