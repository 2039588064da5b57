"""The environment APIs, each thin and generic over domains: PettingZoo AEC and Parallel, Gymnasium, TorchRL."""
