"""One folder per scheduling domain, and the faces that every domain gets for free."""
