"""The only access to PX4: nothing else imports mavsdk; `link` says which program has the link."""
