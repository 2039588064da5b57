"""Logs as JSON: one object a line, whatever was logged."""

import json
import subprocess
import sys

CODE = """
import logging
from marl_sched.comms.logs import set_up_logs
logging.basicConfig(level=logging.WARNING)
set_up_logs("json", "agent-3", "plant")
log = logging.getLogger("marl_sched.comms.agent")
log.info("a %s\\nof two lines", "message")
try:
    1 / 0
except ZeroDivisionError:
    log.exception("failed")
"""


def test_every_line_of_a_json_log_is_an_object_that_says_who_and_what():
    done = subprocess.run([sys.executable, "-P", "-c", CODE], capture_output=True, text=True, timeout=60, check=True)
    first, second = (json.loads(line) for line in done.stderr.splitlines())
    assert first.pop("time").endswith("Z")
    assert first == {
        "process": "agent-3", "run": "plant", "level": "info", "logger": "marl_sched.comms.agent",
        "message": "a message\nof two lines",
    }  # fmt: skip
    assert second["level"] == "error"
    assert "ZeroDivisionError" in second["error"]
