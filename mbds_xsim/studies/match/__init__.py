"""Cheapest settings within the budgets."""
