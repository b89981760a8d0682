"""Many runs: what they are, who does them, what came of them."""
