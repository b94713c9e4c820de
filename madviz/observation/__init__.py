"""Between camera and policy: failures, moved cameras, streams."""
