"""HybridNet and the interactive HetGAT scheduler: learned planners of whole rounds (dissertation, chapter 5)."""
