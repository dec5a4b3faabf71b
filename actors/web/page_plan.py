"""Where the operator's page of a run is, for whom, and encrypted how."""

from __future__ import annotations

import msgspec

from rampart.actors.web.access import page_url


class PagePlan(msgspec.Struct, frozen=True):
    """What is chosen for the operator's page of a run; secrets included.

    Attributes:
        port: TCP port; 0 for no page.
        host: address at which it is served.
        token: what everybody has to show there; "" for nothing, on loopback, or for tokens that a
            file lists.
        token_is_new: it was made for this run, so the operator has yet to be told.
        token_file: path of the list of those who have tokens; "" for none.
        cert: path of the certificate with which it is encrypted; "" for plain HTTP.
        key: path of its key.
        unencrypted: it need not be, though other machines reach it.
        secret: key of its cookies; its node makes one for itself where there is none.
        shown: address or name under which it is shown; "" for the one it is served at.
        audit_log: file that keeps who did what there; "" for none.
        behind: origin under which a reverse proxy serves it; "" without one.
    """

    port: int = 0
    host: str = "127.0.0.1"
    token: str = ""
    token_is_new: bool = False
    token_file: str = ""
    cert: str = ""
    key: str = ""
    unencrypted: bool = False
    secret: str = ""
    shown: str = ""
    audit_log: str = ""
    behind: str = ""

    @property
    def url(self) -> str:
        """Where the page is, "" if there is none; the token is no part of it."""
        if self.behind:
            return f"{self.behind}/"
        return page_url(self.shown or self.host, self.port, tls=bool(self.cert)
                        ) if self.port else ""

    @property
    def invitation(self) -> str:
        """The same, once, for who has started the run: with the token, if it is new."""
        if self.token_is_new:
            return f"{self.url} asks for the token {self.token}"
        return f"{self.url} asks for your token" if self.token or self.token_file else self.url
