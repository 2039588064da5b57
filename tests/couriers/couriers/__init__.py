"""Couriers serve jobs that arrive day by day; a job may be cancelled while it waits, a courier may be away."""
