"""Auctions: how a team shares tasks among itself by messages, without a centre and whatever carries the messages."""
