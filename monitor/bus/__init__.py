"""Zenoh: keys, payloads and their schemas, publishing, subscribing, commands of operators."""
