"""Policies of other programs: a websocket, msgpack, and arrays in it."""
