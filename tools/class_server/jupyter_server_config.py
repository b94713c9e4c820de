"""The configuration of each student's server: idle kernels end, and JupyterLab's launcher opens the
page of ``madviz explore``.

The page listens on 127.0.0.1, which every account of this machine reaches. So it asks for the token
that the hub made for this student's server (MADVIZ_TOKEN), and a browser gets that only through the
hub, as this student:

    /user/ada/madviz/                  the first request starts the page, on a free port
      ──► /user/ada/proxy/41234/?token=T   the page takes the token and sets a cookie
      ──► /user/ada/proxy/41234/           the page; its websocket carries the cookie

The second address, and not the first, since the page opens its websocket without the slash at the
end, which only /proxy/PORT passes on.
"""

import os

c = get_config()  # noqa: F821  (Jupyter's own.)

c.MappingKernelManager.cull_idle_timeout = 3600
c.MappingKernelManager.cull_interval = 300
c.MappingKernelManager.cull_connected = True
c.LabApp.news_url = None
c.LabApp.check_for_updates_class = "jupyterlab.NeverCheckForUpdate"


def forward(response, port) -> None:
    """Sends the browser on, whatever the page itself has answered."""
    response.code, response.reason, response.body = 302, "Found", b""
    response.headers["Location"] = f"../proxy/{port}/?token={os.environ['MADVIZ_TOKEN']}"
    response.headers["Referrer-Policy"] = "no-referrer"


words = ["madviz", "explore", "--port", "{port}", "--visitors", "1", "--workers", "0"]
c.ServerProxy.servers = {
    "madviz": {
        "command": words,
        "timeout": 60.0,
        "rewrite_response": forward,
        "launcher_entry": {"title": "madviz page"},
    }
}
