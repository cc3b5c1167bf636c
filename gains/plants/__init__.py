"""Plants: their TOML, nonlinearities, slope bounds, sampling."""
