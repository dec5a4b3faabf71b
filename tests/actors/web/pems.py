"""Certificates and keys for tests: made once with openssl, good for a hundred years. Not secret.

`robot` is for robot.local, *.robots.example and loopback, `other` for other.local; `old` has ended,
`client` is for clients alone, `bare` has no subjectAltName, `locked` is robot's key with a
passphrase. All sign themselves, with keys of P-256.
"""

from __future__ import annotations

from pathlib import Path

PEMS = {
    "robot.crt": """\
-----BEGIN CERTIFICATE-----
MIIBxzCCAW2gAwIBAgIUAZKKYUrvQNjNWtePwrAMJy5tFuowCgYIKoZIzj0EAwIw
FjEUMBIGA1UEAwwLcm9ib3QubG9jYWwwIBcNMjYxMTIzMTAwMzEwWhgPMjEyNjEw
MzAxMDAzMTBaMBYxFDASBgNVBAMMC3JvYm90LmxvY2FsMFkwEwYHKoZIzj0CAQYI
KoZIzj0DAQcDQgAEdvDJdeO+D+nQj2CRbwGKsmNFkaaaf67LxR1ynze5UaJylgWP
BjzmC2f2swKpa9PCMxjMZryX6PyOkmlI4ENiZ6OBljCBkzAdBgNVHQ4EFgQUaKhq
WsD3wJPwhpV9WN9s6GnMsE4wHwYDVR0jBBgwFoAUaKhqWsD3wJPwhpV9WN9s6GnM
sE4wDwYDVR0TAQH/BAUwAwEB/zBABgNVHREEOTA3ggtyb2JvdC5sb2NhbIIQKi5y
b2JvdHMuZXhhbXBsZYcEfwAAAYcQAAAAAAAAAAAAAAAAAAAAATAKBggqhkjOPQQD
AgNIADBFAiB/moMTA13qFpGeo7dnJM+450HCUYFMcI7j8VDKWUTVFAIhAMsN+vY4
ZbR24NmEgXb13jhql7+8J9uHKb6NjiYMk7o6
-----END CERTIFICATE-----
""",
    "robot.key": """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQg3/s/QunSvWWPQm9f
+ugpSLoZShMr1lf6J1VaSXoxPSqhRANCAAR28Ml1474P6dCPYJFvAYqyY0WRppp/
rsvFHXKfN7lRonKWBY8GPOYLZ/azAqlr08IzGMxmvJfo/I6SaUjgQ2Jn
-----END PRIVATE KEY-----
""",
    "other.crt": """\
-----BEGIN CERTIFICATE-----
MIIBmzCCAUGgAwIBAgIUFStYkPIIPWwmtk9uTIbONsplT2EwCgYIKoZIzj0EAwIw
FjEUMBIGA1UEAwwLb3RoZXIubG9jYWwwIBcNMjYxMTIzMTAwMzEwWhgPMjEyNjEw
MzAxMDAzMTBaMBYxFDASBgNVBAMMC290aGVyLmxvY2FsMFkwEwYHKoZIzj0CAQYI
KoZIzj0DAQcDQgAE/S8g7DpqAxyFHTTVOqYV8y7j1n6SNLpTm5zBtM1FQlS9c7aF
rbZuDw3GeAfFT2LaOXqAPndUlt0JEHYKvJwQQqNrMGkwHQYDVR0OBBYEFIyQWgwV
mtTyXFeV26lBWEDl+X5eMB8GA1UdIwQYMBaAFIyQWgwVmtTyXFeV26lBWEDl+X5e
MA8GA1UdEwEB/wQFMAMBAf8wFgYDVR0RBA8wDYILb3RoZXIubG9jYWwwCgYIKoZI
zj0EAwIDSAAwRQIgJKKxIeIfMeE2gwDwt1Rjzk6veWXGexgMi6Aw1JSVFwACIQDm
OVYgz/xcOCn9zlDTqLfZW0Sro5QKnlQwMTxvptR6eQ==
-----END CERTIFICATE-----
""",
    "other.key": """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgYlI0SV7ia/YHM4S6
VjBqLYgvet9mJwHA1cGfxRWA07ShRANCAAT9LyDsOmoDHIUdNNU6phXzLuPWfpI0
ulObnMG0zUVCVL1ztoWttm4PDcZ4B8VPYto5eoA+d1SW3QkQdgq8nBBC
-----END PRIVATE KEY-----
""",
    "old.crt": """\
-----BEGIN CERTIFICATE-----
MIIBYjCCAQegAwIBAgIUQ7sOJZXAD5rq36K/DaXRIM52hEkwCgYIKoZIzj0EAwIw
FDESMBAGA1UEAwwJb2xkLmxvY2FsMB4XDTI2MTEyMzEwMDMxMFoXDTI2MTEyMjEw
MDMxMFowFDESMBAGA1UEAwwJb2xkLmxvY2FsMFkwEwYHKoZIzj0CAQYIKoZIzj0D
AQcDQgAENMv2ugtknrTHh9RWxoKqgFgnd3a3hnoc4t2cjI3VfnrxKnnVFl0M0TaY
9URoSAAjDMoa9idB2oK/kruBKs0x36M3MDUwFAYDVR0RBA0wC4IJb2xkLmxvY2Fs
MB0GA1UdDgQWBBSOy31zLn7Q7hfEyXR0hsWItEbPgjAKBggqhkjOPQQDAgNJADBG
AiEAjj/XYYJAFXsUmWdR8xRDgZktGv0vYdHgquVF+LRMZgUCIQCVII8327+eR9mq
L7cN4diHQaG/j4Fox8xYRtm0EWkzZw==
-----END CERTIFICATE-----
""",
    "old.key": """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgPHiJNgZBkbdhPgya
FmPBAUC5gnE1GSWXtEhbdLlicZ6hRANCAAQ0y/a6C2SetMeH1FbGgqqAWCd3dreG
ehzi3ZyMjdV+evEqedUWXQzRNpj1RGhIACMMyhr2J0Hagr+Su4EqzTHf
-----END PRIVATE KEY-----
""",
    "client.crt": """\
-----BEGIN CERTIFICATE-----
MIIBjjCCATSgAwIBAgIUDrXPfkhPpqhD4PjTjgkTyPLbz1gwCgYIKoZIzj0EAwIw
ETEPMA0GA1UEAwwGY2xpZW50MCAXDTI2MTEyMzEwMDMxMFoYDzIxMjYxMDMwMTAw
MzEwWjARMQ8wDQYDVQQDDAZjbGllbnQwWTATBgcqhkjOPQIBBggqhkjOPQMBBwNC
AATl6hb6bsDxsFRqgyGsJkoy8HqmMwnAO6D/aHGL8RdI8YokKh21WbW6iJgBa24L
Jz3lrPhdGuOccbIS7hb5yZ+/o2gwZjAdBgNVHQ4EFgQUivbJ/u52SHmpSaH2KTKw
KER0uk4wHwYDVR0jBBgwFoAUivbJ/u52SHmpSaH2KTKwKER0uk4wDwYDVR0TAQH/
BAUwAwEB/zATBgNVHSUEDDAKBggrBgEFBQcDAjAKBggqhkjOPQQDAgNIADBFAiEA
m9y0X65nOwcjz8NogSChvB507mKKPkcxHyMWd1vn/jYCIAbzV8Apdjk2YTAPWIi8
u1I1uy/UALvxzY2mqMxRmx8O
-----END CERTIFICATE-----
""",
    "client.key": """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgfQ6U7FlnCCTI+bXI
ouCkt/HjqOiXTu66v1tJ5zUYsQWhRANCAATl6hb6bsDxsFRqgyGsJkoy8HqmMwnA
O6D/aHGL8RdI8YokKh21WbW6iJgBa24LJz3lrPhdGuOccbIS7hb5yZ+/
-----END PRIVATE KEY-----
""",
    "bare.crt": """\
-----BEGIN CERTIFICATE-----
MIIBdDCCARugAwIBAgIUDd//aMW5LIfe+nQGP931PbiSTywwCgYIKoZIzj0EAwIw
DzENMAsGA1UEAwwEYmFyZTAgFw0yNjExMjMxMDAzMTBaGA8yMTI2MTAzMDEwMDMx
MFowDzENMAsGA1UEAwwEYmFyZTBZMBMGByqGSM49AgEGCCqGSM49AwEHA0IABBAq
JTpmQZRYkrVzKXikzyYpxDkDBMgs/UIK184tWMS+KFh5iFIybpJhux8mQ1NksR24
Faz4Ho7JNKn+UxpU81qjUzBRMB0GA1UdDgQWBBTONHO89AebVEtTso2HQqR44c+l
OjAfBgNVHSMEGDAWgBTONHO89AebVEtTso2HQqR44c+lOjAPBgNVHRMBAf8EBTAD
AQH/MAoGCCqGSM49BAMCA0cAMEQCIGX0SLpsU2bnb8ZyJZBu5UOReGZhrivGQtHl
bgUjrQmZAiBn9+B+fkjvjIbl7dF+e1tB8r9su6o2puSB+vT6xUScsw==
-----END CERTIFICATE-----
""",
    "bare.key": """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgxyikMfQhx6+kg/TI
YDHGx5B5LJ2gYtDJi9/z5BZx6vKhRANCAAQQKiU6ZkGUWJK1cyl4pM8mKcQ5AwTI
LP1CCtfOLVjEvihYeYhSMm6SYbsfJkNTZLEduBWs+B6OyTSp/lMaVPNa
-----END PRIVATE KEY-----
""",
    "locked.key": """\
-----BEGIN EC PRIVATE KEY-----
Proc-Type: 4,ENCRYPTED
DEK-Info: AES-128-CBC,21039294FBAFEBF5C1A2234EC055DFA9

e20zzcf/5Am5Qkt4G/66F2VFr9FsORawchrJb7aJCXQAABuZfitml2V8hqAYDRaH
NmnqYhwteCknf3ycJ9XKikYhTCG5mrzINBNzsoCYqiT1mgzGs/Y23F/ESMN0DGCz
Kd/FrFLO5RTG0pvEeIbu2vVOAtpCR1qMnXaSvSa+nZM=
-----END EC PRIVATE KEY-----
""",
}


def pem(folder: Path, name: str) -> Path:
    """Write one into a folder, as its owner would keep it, and return its path."""
    file = folder / name
    file.touch(0o600)
    file.write_text(PEMS[name])
    return file


def pair(folder: Path, name: str = "robot") -> tuple[Path, Path]:
    """Write a certificate and its key."""
    return pem(folder, f"{name}.crt"), pem(folder, f"{name}.key")
