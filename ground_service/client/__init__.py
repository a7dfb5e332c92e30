"""Client of the ground service: over HTTP, or in-process on the local database.

`Client` has one method for each operation of the HTTP API, with the name of the operation. Results are the pydantic
models of the capabilities; lists fetch their pages during iteration.
"""

from ground_service.client.connection import ServiceProblem
from ground_service.client.tasks import Client

__all__ = ["Client", "ServiceProblem"]
