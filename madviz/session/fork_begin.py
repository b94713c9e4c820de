"""The first module of the process that simulations are forked from: until ``fork_server.py`` has
been imported, the last one, no garbage is collected (``system/collection.py``)."""

import gc

gc.disable()
