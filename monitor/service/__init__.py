"""The daemon: links to vehicles, vehicles to pipelines, health, metrics, standby."""
