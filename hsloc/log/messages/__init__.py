"""Message payloads: definitions, decoding, encoding."""
