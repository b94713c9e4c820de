"""The explorer as static files: simulator, cameras and policy in the visitor's own browser."""
