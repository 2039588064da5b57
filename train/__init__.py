"""How policies learn, and how they are evaluated and compared."""
