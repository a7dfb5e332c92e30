"""What every endpoint shares: connections, limits, origins, uploads, problem details, schemas, time formats."""
