"""Settings: every class of the configuration, checked once and light to import."""
