"""The folder of a campaign: finished cases as Parquet shards, and claims on cases."""
