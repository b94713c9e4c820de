"""MV-MAE and MV-MWM: a masked autoencoder over views, and a world model over its tokens."""
