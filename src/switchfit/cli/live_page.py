"""A page that shows an online estimator at work, served to browsers on this machine only.

The page is one static file, which asks for ``/now.json`` twice a second. One thread adds what the estimator says, any
number of others answer browsers: they read a tuple that is replaced, never changed.
"""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Self
from urllib.parse import parse_qs, urlsplit

from switchfit.problem.problem import Problem
from switchfit.report import style
from switchfit.runtime.errors import InputError

ADDRESS = "127.0.0.1"

LOCAL_HOSTS = (ADDRESS, "localhost")
"""Hosts that a request may name: a page of another site, whose name leads here, is refused."""

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; img-src data:"

MOST_KEPT_LINES = 2000
"""Samples that a page which is opened late still gets."""


class LivePage:
    """Serves the page from when it is entered as a context until it is left.

    Parameters
    ----------
    name : str
        What is estimated.
    problem : Problem
    port : int
        0 takes a free one.

    Raises
    ------
    InputError
        If the port cannot be used.
    """

    def __init__(self, name: str, problem: Problem, port: int) -> None:
        (run,) = problem.experiments
        self.head = {
            "name": name,
            "unit": run.time_unit,
            "units": {name: parameter.unit for name, parameter in problem.parameters.items()},
            "colours": style.assign_colours(problem.system.modes, style.LINE_COLOURS),
        }
        templates = files("switchfit.report.html") / "templates"
        page, css = ((templates / each).read_text(encoding="utf-8") for each in ("live.html", "report.css"))
        self.page = page.replace("/* report.css */", css)
        self._state: tuple[int, tuple[str, ...]] = (0, ())
        try:
            self._server = ThreadingHTTPServer((ADDRESS, port), _make_handler(self))
        except (OSError, OverflowError) as error:
            raise InputError(f"the page cannot be served on port {port}: {error}; name another with --live.") from error
        self._server.daemon_threads = True
        self.address = f"http://{ADDRESS}:{self._server.server_port}"

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, line: str) -> None:
        """Add what the estimator has said, a line of JSON."""
        count, lines = self._state
        # One assignment of a tuple, which is atomic: a thread that answers sees the state before or after it, and needs
        # no lock. The count goes on while old lines are dropped, so that a page knows what it has missed.
        self._state = (count + 1, (*lines[1 - MOST_KEPT_LINES :], line))

    def list_lines(self, after: int) -> str:
        """Return the lines after so many, with how many there are, as JSON."""
        count, lines = self._state
        # A page that knows more lines than there were is from an earlier run: it gets all of them.
        new = lines[max(len(lines) - (count - after), 0) :] if after <= count else lines
        return f'{{"head": {json.dumps(self.head)}, "count": {count}, "lines": [{",".join(new)}]}}'

    def wait(self) -> None:
        """Wait until an exception, such as that of Ctrl-C, ends it."""
        threading.Event().wait()


def _make_handler(live: LivePage) -> type[BaseHTTPRequestHandler]:
    """Return the class that answers requests."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = urlsplit(self.path)
            # A name of another site that is resolved to 127.0.0.1 (DNS rebinding) would otherwise let its scripts read
            # this.
            if self.headers.get("Host", "").partition(":")[0] not in LOCAL_HOSTS:
                self.send_error(403)
            elif asked.path == "/":
                self.answer("text/html", live.page)
            elif asked.path == "/now.json":
                # Twelve digits at most: int() of a million digits takes seconds.
                after = parse_qs(asked.query).get("after", ["0"])[0][:12]
                self.answer("application/json", live.list_lines(int(after) if after.isdecimal() else 0))
            else:
                self.send_error(404)

        def answer(self, kind: str, text: str) -> None:
            content = text.encode()
            self.send_response(200)
            headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": f"{len(content)}"}
            headers |= {"Cache-Control": "no-store", "Content-Security-Policy": POLICY}
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing: stderr is for what concerns the estimate."""

    return Handler
