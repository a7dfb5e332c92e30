"""What every endpoint shares: limits, origins, uploads, problem details, schemas, time formats."""
