"""MAVLink: bytes of links, packets to messages, signing, rates."""
