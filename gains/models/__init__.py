"""Built-in plant models, addressed by name: ``fauio design arm``."""
