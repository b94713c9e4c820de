"""One time step explained: probes, Shapley values, projection, saliency."""
