"""Proof that a sample comes from a holder of a shared secret: an HMAC of its key and payload, as its attachment."""

from __future__ import annotations

import hashlib
import hmac
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh


class Seal:
    """Makes and verifies the attachments of samples with a secret that all monitors of a vehicle share.

    Nobody without the secret can change or invent a sample. A sample that is sent again unchanged cannot be told from
    the first: receivers have to count.
    """

    def __init__(self, secret: bytes) -> None:
        self._secret = secret

    def attachment(self, key: str, payload: bytes) -> bytes:
        """Return the proof of a sample."""
        text = key.encode()
        # the length tells where the key ends: no two samples have the same bytes
        return hmac.digest(self._secret, len(text).to_bytes(4, "little") + text + payload, hashlib.sha256)

    def holds(self, sample: zenoh.Sample) -> bool:
        """Return whether a received sample has its proof."""
        if sample.attachment is None:
            return False
        expected = self.attachment(str(sample.key_expr), sample.payload.to_bytes())
        return hmac.compare_digest(sample.attachment.to_bytes(), expected)
