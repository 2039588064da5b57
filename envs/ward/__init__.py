"""Delivery ward: nurses admit women in labour as they arrive, and care for them until they leave."""
