"""What decides in MuRSE: exact and mathematical-programming schedulers, searches and auctions."""
