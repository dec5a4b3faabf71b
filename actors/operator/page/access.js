// The token of a page that other machines can reach: taken from the address once, kept by this tab.
// Other fragments are places on the page.

const KEY = "rampart-token";

function fromAddress() {
  const found = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!found) return false;
  sessionStorage.setItem(KEY, found);
  history.replaceState(null, "", location.pathname + location.search);  // not to be read over a shoulder
  return true;
}

fromAddress();
addEventListener("hashchange", () => { if (fromAddress()) location.reload(); });

export const token = () => sessionStorage.getItem(KEY) || "";

/** Subprotocols of the WebSocket: a browser sends no header of ours, but these. */
export const protocols = () => (token() ? ["rampart", `token.${token()}`] : ["rampart"]);

/** Headers with which to ask the HMI for what is not one of its files: no address holds the token. */
export const headers = () => (token() ? { authorization: `Bearer ${token()}` } : {});

export const NO_TOKEN = 4401;
