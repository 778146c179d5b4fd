"""The guardian processes, and how a bench is made safe from outside."""
