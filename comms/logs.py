"""What the processes of a run log: lines of text, or JSON objects, one a line."""

from __future__ import annotations

import json
import logging
import time
from typing import Any, Literal

LogFormat = Literal["text", "json"]


class JsonFormatter(logging.Formatter):
    """A record as one JSON object: `time` (UTC, ISO 8601), `process`, `run`, `level`, `logger`, `message`, `error`.

    `error` is the traceback of an exception that was logged; it is missing otherwise.
    """

    def __init__(self, process: str, run: str) -> None:
        super().__init__()
        self._who = {"process": process, "run": run}

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        said: dict[str, Any] = {
            "time": f"{moment}.{int(record.msecs):03d}Z",
            **self._who,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            said["error"] = self.formatException(record.exc_info)
        return json.dumps(said, ensure_ascii=False)


def set_up_logs(form: LogFormat, process: str, run: str) -> None:
    """Have this process log to stderr as JSON, events such as joined and lost agents included.

    As text, which is what processes begin with, nothing is changed.
    """
    if form == "text":
        return
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter(process, run))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    logging.getLogger("marl_sched").setLevel(logging.INFO)
