"""`python -m runners.serve`: offers sessions to other programs on a local port."""

from __future__ import annotations

import os
import secrets
import socket
import sys
from dataclasses import dataclass
from pathlib import Path

from aiohttp import web
from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.methods import build_method, default_method
from chsel.numerics.threads import set_threads
from chsel.policies import build_policy
from chsel.problem.settings import build_settings
from chsel.session.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from replay.console import Console
from runners.command.program import command, plain
from runners.run.display import compiling_line
from runners.serving.messages import OpenRequest
from runners.serving.server import PATIENCE, Server


@dataclass(frozen=True)
class ServeConfig:
    """conf/serve.yaml, which has all defaults and says what they are, checked."""

    host: str
    port: int
    folder: str
    threads: int


@command("serve")
def main(config: DictConfig) -> None:
    """Compile the kernels, listen, and answer until Ctrl-C or SIGTERM."""
    checked = build_settings(ServeConfig, plain(config), where="serve")
    console = Console(soft_wrap=True)
    given = os.environ.get("CHSEL_TOKEN")
    folder = Path(checked.folder).expanduser()
    token = given or secrets.token_urlsafe()
    set_threads(checked.threads)
    try:
        listening = socket.create_server((checked.host, checked.port))
    except (OSError, OverflowError) as error:
        where = f"port {checked.port} of host {checked.host} cannot be opened"
        raise SettingError(
            f"{where} ({error}); accepted: a free one of this machine, or 0"
        ) from None
    with listening:
        folder.mkdir(parents=True, exist_ok=True)
        with compiling_line():
            warm_up(build_method(default_method(OpenRequest.preset)))
            warm_up_sensing()
            warm_up_policy(build_policy(OpenRequest.policy))
        host, port = listening.getsockname()
        console.print(f"serving at http://{host}:{port}, recordings in {folder}/, until Ctrl-C")
        console.print(f"token: {token}" if not given else "token: that of CHSEL_TOKEN")
        server = Server(token, folder)
        web.run_app(
            server.app,
            sock=listening,
            print=lambda *_: None,
            access_log=None,
            shutdown_timeout=PATIENCE,
        )
    if server.is_computing:  # for nobody: Python would wait for it
        sys.stderr.flush()
        os._exit(0)


if __name__ == "__main__":
    main()
