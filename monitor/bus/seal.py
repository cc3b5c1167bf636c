"""Proof that a sample comes from a holder of a shared secret: an HMAC of its key and payload, as its attachment."""

from __future__ import annotations

import hashlib
import hmac
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zenoh


class Seal:
    """Makes and verifies the attachments of samples by a secret that all monitors of a vehicle share.

    Whoever does not know the secret can change or invent no sample; one that is sent again as it was is not told from
    the first: receivers count.
    """

    def __init__(self, secret: bytes) -> None:
        self._secret = secret

    def attachment(self, key: str, payload: bytes) -> bytes:
        """Return what proves a sample."""
        text = key.encode()
        # the length says where the key ends: no two samples have the same bytes
        return hmac.digest(self._secret, len(text).to_bytes(4, "little") + text + payload, hashlib.sha256)

    def holds(self, sample: zenoh.Sample) -> bool:
        """Return whether a sample that was received has its proof."""
        if sample.attachment is None:
            return False
        expected = self.attachment(str(sample.key_expr), sample.payload.to_bytes())
        return hmac.compare_digest(sample.attachment.to_bytes(), expected)
