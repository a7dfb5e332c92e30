"""OpenAPI document of the application."""

from __future__ import annotations

import json
import re
from typing import Any

from fastapi import FastAPI

from ground_service.http.model import Problem

_PAGE = re.compile(r"PageOf_(\w+?)_(?=\")")


class DescribedApi(FastAPI):
    """Application whose OpenAPI document has problem documents as errors and pages named after their entity."""

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            document: dict[str, Any] = super().openapi()
            document["components"]["schemas"]["Problem"] = Problem.model_json_schema()
            self.openapi_schema = json.loads(_PAGE.sub(r"\1Page", json.dumps(document)))
        return self.openapi_schema
