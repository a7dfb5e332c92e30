"""Errors of the client: problem details of the service as exceptions.

ServiceProblem
├── Unreachable          no connection, or a connection that broke
├── NotAuthenticated     401: no valid token
├── NotPermitted         403: the role does not permit the operation
├── NotFound             404
├── Conflict             409 and 412: the request contradicts the stored state
├── InvalidRequest       400, 413, 415 and 422
├── Unavailable          429, 503 and 507: the service is busy or cannot store
└── JobFailed            the job of the request failed
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ground_service.errors import GroundError
from ground_service.http.model import Problem

if TYPE_CHECKING:
    import httpx


class ServiceProblem(GroundError):
    """A request without a successful response.

    Attributes
    ----------
    status
        HTTP status; 0 if there was no response.
    problem
        Problem details (RFC 9457) of the response; None if it has none.
    """

    def __init__(self, status: int, detail: str, problem: Problem | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.problem = problem


class Unreachable(ServiceProblem):
    """No connection to the service, or a connection that broke."""


class NotAuthenticated(ServiceProblem):
    """The service requires a valid token."""


class NotPermitted(ServiceProblem):
    """The role of the user does not permit the operation."""


class NotFound(ServiceProblem):
    """The resource does not exist."""


class Conflict(ServiceProblem):
    """The request contradicts the stored state; `problem.state` is that state where one state is the reason."""


class InvalidRequest(ServiceProblem):
    """The service refused the input."""


class Unavailable(ServiceProblem):
    """The service is busy or cannot store; the same request may succeed later."""


class JobFailed(ServiceProblem):
    """The job of the request failed."""


_KINDS: dict[int, type[ServiceProblem]] = {
    401: NotAuthenticated,
    403: NotPermitted,
    404: NotFound,
    **dict.fromkeys((409, 412), Conflict),
    **dict.fromkeys((400, 413, 415, 422), InvalidRequest),
    **dict.fromkeys((429, 503, 507), Unavailable),
}


def problem_of(response: httpx.Response) -> ServiceProblem:
    """Return the exception for a response that is not a success; its body must have been read."""
    status = response.status_code
    kind = _KINDS.get(status, ServiceProblem)
    absent = {"type": "about:blank", "title": response.reason_phrase, "status": status}
    try:
        problem = Problem.model_validate({**absent, **response.json()}, extra="ignore")
    except (ValueError, TypeError):  # not a problem document: for example the page of a proxy
        return kind(status, f"{response.request.url}: {status} {response.reason_phrase}")
    return kind(status, problem.detail, problem)
