"""Pipeline configuration: pydantic models, YAML loading, presets."""
