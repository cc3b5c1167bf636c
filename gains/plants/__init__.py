"""Plants: their model files, nonlinearities, slope bounds and sampling."""
