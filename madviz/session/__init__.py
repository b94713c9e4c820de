"""One visitor's session: simulation, past, plan and pace."""
