"""The page: panels that draw frames and send commands. The only folder that knows viser."""
